"""What the commands are made of; each command is in the file that has its name."""
