"""Reports from run folders: figures, HTML, acceptance tests."""
