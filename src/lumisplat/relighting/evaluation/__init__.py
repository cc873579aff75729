"""Found materials and light against a known truth."""
