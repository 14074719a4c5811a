"""`make compare`: every method, ours among them, on the same clouds, by the same metrics, in one table."""
