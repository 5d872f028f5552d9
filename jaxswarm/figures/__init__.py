"""The figures of the thesis: their runs, their claims and the report."""
