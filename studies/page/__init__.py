"""Pages that people look at: what is on them, and how they become HTML or Markdown."""
