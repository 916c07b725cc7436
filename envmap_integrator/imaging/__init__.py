"""From camera samples to pictures: sample points, film, filters."""
