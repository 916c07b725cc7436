"""Stage 1: patches over the surfaces that matter to the sensors."""
