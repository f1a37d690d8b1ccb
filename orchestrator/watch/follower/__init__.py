"""The follower: a process next to the driver that reads run.db and passes on what happens in the run.

It sends notifications to people and curves to programs that keep them (sinks). It can neither delay nor
change the run: it only reads the run folder, but for RUN/follower/, where it keeps what has been delivered.
"""
