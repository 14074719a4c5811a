"""Trained weights that come with the package, and the Python interface to them: `articulate_ssl.load`."""
