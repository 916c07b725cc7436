"""Stage 1: irradiance on the patches."""
