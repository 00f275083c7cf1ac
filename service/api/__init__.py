"""The HTTP side; status codes exist here and nowhere else."""
