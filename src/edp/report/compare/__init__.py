"""Several runs beside each other: `runs` reads, `paired` compares, `charts` and `page` show."""
