"""Typed settings: their schema, composing them from YAML and the command line, checking them."""
