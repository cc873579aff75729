"""Data that kernels exchange: one struct is one noun of the method."""
