"""A study with people: its plan, its trials, its statistics (`share study`).

    plan            who meets which condition when, by letters; the key to the letters
    orders          orders of conditions, balanced for place and carry-over
    spots           where participants call the robot
    session         a participant led through what is left (`share study run`), by
      progress        what that is
      trial_runner    one trial: the machine below, the room, the log, the terminal in one loop
      trial_machine   a trial as a state machine: spot, call, robot, standstill
      standstill      when the robot moved first and since when it stands
      floor           the plan's floor in the shared map, by a marker
      readiness       whether all is well for a trial
      study_room      the edge of a trial, started by letter, and a client of it
      study_log       lines that a power cut does not take
      asking          questions and answers; question_page serves them
    trials          what a trial leaves behind, and whether the robot came
    observations    the table that is analysed, from trials or from a CSV file
    rank_tests      Friedman, Wilcoxon, Holm, Nemenyi, preferences
    repeated_anova  repeated-measures ANOVA, order effects
    resampling      intervals over participants
    power           of the next study
    study_analysis  all tests of all measures
    study_tables    these as tables of text
    study_figures   and as pictures
    study_report    HTML, CSV, LaTeX

Letters become policies in `plan` and `observations`; all else knows conditions by the names that it is given.
"""
