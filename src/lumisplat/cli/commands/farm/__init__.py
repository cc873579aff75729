"""Commands whose frames are made by workers."""
