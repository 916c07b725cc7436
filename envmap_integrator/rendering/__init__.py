"""Stage 3: light transport that traces near, looks up far, and ends in the irradiance cache."""
