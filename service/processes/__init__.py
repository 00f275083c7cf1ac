"""Work in other processes and threads: typed requests, forked numerics."""
