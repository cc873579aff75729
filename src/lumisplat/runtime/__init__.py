"""Execution of kernels: launches, device buffers, tables of structs, the kernel cache."""
