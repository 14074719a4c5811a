"""`make figures`: figures of the paper that show what a network has learnt, by any weights, on any labelled set."""
