"""Scheduling: what each agent may send, and which merges are worth their time
(docs/understand/scheduling.md).

Begin with `rate_scheduler.RateScheduler.evaluate`, which gets each evaluation of an agent:

    policies             the rate of an agent, of `share` by a PID controller
    qoe                  quality of experience, by delay and error
    room_controller      what each agent gets where the air that all share is short, over time
    room_budget          how long keyframes take on that air, and how much of it is used
    rate_allocation      rates in small steps, each to the agent that gains most
    room_capacity        is there air for one more agent?
    base_delay           a delay without queues
    merge_gate           skips merges of views that overlap little
"""
