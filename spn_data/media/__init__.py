"""Media files from outside, opened the same safe way for pictures and for subtitles."""
