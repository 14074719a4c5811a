"""Lightning DataModules and the npz shard format."""
