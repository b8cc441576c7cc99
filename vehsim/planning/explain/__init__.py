"""Why marks cannot be met: what bounds rule out before solving, and what relaxed problems say afterwards."""
