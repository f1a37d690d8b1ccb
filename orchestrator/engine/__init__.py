"""The engine of a run: what begins when and where, estimates, and each stage. The only writer."""
