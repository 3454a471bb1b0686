"""Which sensors? Structure, observability and H2 measures."""
