"""Diagnostics of recordings and their bench before a fit; the survey of recordings needs no MuJoCo."""
