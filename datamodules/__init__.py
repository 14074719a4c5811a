"""Lightning DataModules, the npz shard format and the geometry that data and method share."""
