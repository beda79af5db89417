"""Claims and their verdicts: questions declared first, seeds added until they are decided, results
of many pooled."""
