"""What the rest stands on: Dr.Jit, files, memory, signals, scenes as content."""
