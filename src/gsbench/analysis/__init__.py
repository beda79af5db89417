"""What result files say: cells, statistics, tables, report. Loads no torch."""
