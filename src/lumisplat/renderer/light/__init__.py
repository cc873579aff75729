"""Direct light at the interactions of a wave of rays."""
