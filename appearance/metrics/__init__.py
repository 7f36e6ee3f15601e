"""How well rendered images agree with captured ones."""
