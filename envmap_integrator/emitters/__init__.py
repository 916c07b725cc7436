"""Emitter plugins, one per file."""
