"""Commands that find, change and bake the light of captures."""
