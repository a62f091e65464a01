"""Which place: the belief over the grid and off it, hypotheses, and how far an answer can be trusted."""
