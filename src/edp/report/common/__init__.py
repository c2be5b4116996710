"""What all pages share: style, tables, figures, templates, wording."""
