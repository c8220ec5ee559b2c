"""Shared parts: recordings, segments, states, parameters, settings, errors and files."""
