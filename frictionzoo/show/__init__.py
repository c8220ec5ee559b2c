"""What a person sees: figures, pages and the terminal's text."""
