"""Actors and critics, and the policy that collects."""
