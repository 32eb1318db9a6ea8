"""Report pages: `model` is their content, `plotting` draws charts, `write` makes files."""
