"""PlayCanvas SOG: read, written, and read in levels of detail."""
