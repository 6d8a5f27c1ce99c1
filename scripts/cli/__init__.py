"""The headway command: the one place that composes the others."""
