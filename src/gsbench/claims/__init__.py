"""Claims and their verdicts: declared questions, seeds until they are decided, pooled results."""
