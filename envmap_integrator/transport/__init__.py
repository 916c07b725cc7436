"""Stage 3: light transport, traced near and looked up far."""
