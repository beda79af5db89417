"""Claims and their verdicts: a plan written down first, seeds added until it is decided, results of many pooled."""
