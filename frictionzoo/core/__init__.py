"""What all parts share: recordings and segments, states, parameters, settings, errors and files."""
