"""Parts and joints of ONE object that was scanned in several states: far easier than a category, and far more exact.

`find.py` is the entry. `surface.py` measures distances along normals, `moving_labels.py` gives points to parts,
`adjustment.py` refines poses, states and joint lines of all clouds at once. `template.py` makes a category's shape of
what was found.
"""
