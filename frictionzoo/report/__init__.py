"""What a run tells: `result.json`, figures, and a summary on the terminal."""
