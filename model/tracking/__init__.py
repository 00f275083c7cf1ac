"""The pieces of the tracker: filter, variance inflation, changes, misfit, and the value that holds them."""
