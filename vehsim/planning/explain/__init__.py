"""Why marks cannot be met: bounds before solving, and relaxed problems afterwards."""
