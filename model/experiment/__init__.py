"""Which run parts models that one recording could not: a menu, the evidence that each run promises, the best first."""
