"""Runs made readable: tables and curves."""
