"""Training: the LightningModule, its recipes and schedule, checkpoints, and the report of a test."""
