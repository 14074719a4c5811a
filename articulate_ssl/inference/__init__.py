"""What a user does with a trained model: read a scan, predict, write the results, draw them."""
