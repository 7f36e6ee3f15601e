"""The console: pages for the people at a stage, who steer it by the API as everybody does."""
