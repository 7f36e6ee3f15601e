"""How well rendered pictures agree with captured ones."""
