"""How figures are laid out: from what a command measured to the table or text a page shows."""
