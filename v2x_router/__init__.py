"""The V2X router: a process that hosts the V2X bus alone; no edge that ends takes others along."""
