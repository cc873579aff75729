"""The light of a captured scene on what is put into it: lights found, probes, transfer to avatars, shadows."""
