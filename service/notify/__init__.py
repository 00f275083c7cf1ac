"""Telling others: events written down with what they tell of, then sent until they arrive or are given up."""
