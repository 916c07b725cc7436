"""Experiments: our integrators against path tracing. Not part of the installed package."""
