"""Commands about this machine rather than a scene."""
