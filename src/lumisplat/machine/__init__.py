"""What this machine has for Lumisplat."""
