"""Built-in campaigns, one YAML file each."""
