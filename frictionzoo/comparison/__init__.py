"""Runs on the same data side by side: which friction law to take, and how sure that is."""
