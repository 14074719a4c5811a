"""Drawings of predictions, and the colour that each part has in every file and picture."""
