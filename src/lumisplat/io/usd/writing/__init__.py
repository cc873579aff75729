"""OpenUSD files, written."""
