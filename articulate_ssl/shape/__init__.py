"""The articulated shape: labelled points with joints, what an instance adds to them, and how they are observed."""
