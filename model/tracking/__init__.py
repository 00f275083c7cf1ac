"""The pieces of the tracker: filter, scatter, changes, misfit, and the value that holds them."""
