"""``armsight serve``: keep ``armsight measure`` going for days."""
