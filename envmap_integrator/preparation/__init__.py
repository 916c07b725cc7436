"""What is made before rendering, in the order of the paper."""
