"""A checked planning request: marks, ranges, legs between marks, and the requests for the audit."""
