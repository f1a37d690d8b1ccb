"""How panoramas were captured: what Stage I learns of it besides the place, and later stages keep."""
