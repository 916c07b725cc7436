"""Stage 1: a coarse mesh of patches over every surface, and the irradiance they receive."""
