"""Rotation groups, rigid and screw motions, kinematic chains: shared by data and method, importing nothing of ours."""
