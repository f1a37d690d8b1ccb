"""The paper's tables, and what the recipes are worth, by one command."""
