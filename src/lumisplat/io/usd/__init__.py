"""OpenUSD files, read and written by usd-core: .usda, .usdc and .usdz."""
