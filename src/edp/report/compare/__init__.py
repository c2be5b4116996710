"""Comparison of several runs: `runs` reads, `paired` compares, `charts` and `page` show."""
