"""The book of claims: every figure of the source, computed again."""
