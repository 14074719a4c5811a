"""Part discovery: a category's parts and joints from unlabelled clouds, by registration, without a network."""
