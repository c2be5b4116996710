"""Parts common to all pages: style, tables, figures, templates, wording."""
