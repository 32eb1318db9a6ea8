"""Pages of reports: `model` is their content, `plotting` draws charts, `write` makes files."""
