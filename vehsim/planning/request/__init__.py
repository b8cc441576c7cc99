"""What a plan is asked for, checked: marks, ranges, legs between marks, and all of it as asks for the audit."""
