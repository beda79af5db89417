"""Tables of inputs and of what is said of them, which the tests go through."""

from gsbench.parsing import table_beside

TABLES = table_beside(__file__, "tables.yaml")
