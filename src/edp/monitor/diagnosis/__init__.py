"""What an alarm means: which part and kind of fault, how large, how grave, and what it could be instead."""
