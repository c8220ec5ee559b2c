"""Output for people: figures, HTML pages and terminal text."""
