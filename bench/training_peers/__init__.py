"""How near others come on a CPU in the time that Lumisplat takes: ``python -m bench.training_peers``."""
