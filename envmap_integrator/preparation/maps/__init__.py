"""Stage 2: clusters of objects and the cube maps of what lies beyond them."""
