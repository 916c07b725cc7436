"""Integrator plugins, one per file."""
