"""Instant multiple scattering."""
