"""Server-rendered pages: no scripts, no other hosts, readable on a phone beside the track."""
