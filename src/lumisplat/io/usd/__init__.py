"""Reads and writes OpenUSD files (.usd, .usda, .usdc and .usdz) with usd-core."""
