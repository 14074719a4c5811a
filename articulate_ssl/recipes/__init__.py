"""Training recipes: the paper's single objective, and the staged schedule with part discovery in between."""
