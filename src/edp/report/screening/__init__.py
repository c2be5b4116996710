"""The page of a screening of channels."""
