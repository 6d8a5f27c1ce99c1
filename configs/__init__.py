"""One YAML a machine (and its tasks): what a user copies and edits."""
