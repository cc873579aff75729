"""Everything once, on a device that is new to us: ``python -m bench.first_light``."""
