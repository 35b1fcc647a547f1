"""The network of Diao, Chi and Wang, and what it needs."""
