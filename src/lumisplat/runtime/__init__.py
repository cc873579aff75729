"""Where kernels run and what memory they use: launches, buffers, tables of structs."""
