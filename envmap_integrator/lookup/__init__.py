"""What kernels read; nothing here builds it."""
