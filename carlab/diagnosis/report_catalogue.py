"""The catalogue in words: for each effect a noun, a sentence with its numbers, and what would prove it wrong.

``left_out`` is a template over the effect's parameters; ``carlab.diagnosis.report_text`` fills it. ``{p}`` is the
number with unit and interval, ``{p:size}`` its magnitude (with ``{p:left|right}`` for the sign), ``{p:percent}`` and
``{p:size percent}`` the same in per cent, ``{p:each minute}`` a rate [1/s] in per cent a minute, ``{p:choice a|b}`` a
word for a choice.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class EffectText:
    """Words for one effect of the catalogue."""

    noun: str
    left_out: str
    wrong_if: str


EFFECT_TEXTS: dict[str, EffectText] = {
    "command_delay": EffectText(
        "a command delay that is not the car file's",
        "both commands act {extra_delay:size} {extra_delay:later|earlier} than the car file says",
        "steering and throttle turn out late by different amounts, or a delay measured at the car is the car file's",
    ),
    "steering_delay": EffectText(
        "a delay of the steering",
        "the steering command acts {delay} later than the throttle command",
        "the wheels start to move at once and only arrive late, or fast steering comes out weaker than slow steering",
    ),
    "throttle_delay": EffectText(
        "a delay of the throttle",
        "the throttle command acts {delay} later than the steering command",
        "the car starts to gain speed at once after a step of throttle, only more gently",
    ),
    "steering_lag": EffectText(
        "a lag of the steering servo",
        "the steering servo lags by {time_constant}",
        "the wheels reach their angle after the same pause for a small and for a large step (a delay), or later the "
        "larger the step is (a limit of their rate)",
    ),
    "steering_rate_limit": EffectText(
        "a limit of the steering servo's speed",
        "the steering servo turns the wheels no faster than {rate}",
        "small steps of steering are as late as large ones",
    ),
    "steering_deadband": EffectText(
        "a dead band of the steering",
        "the steering ignores small commands around straight ahead, in a band {width} wide",
        "the wheels also stand still for a moment when the steering turns back far from straight ahead",
    ),
    "steering_backlash": EffectText(
        "play in the steering",
        "the steering linkage has {play} of play, which is taken up anew at each turn back",
        "commands are ignored around straight ahead only, whichever way the wheels moved before",
    ),
    "steering_offset": EffectText(
        "a steering that is not centred",
        "with a steering command of zero the wheels point {angle:size} to the {angle:left|right}",
        "the pull to one side fades as speed grows, or the heading is off without the path being curved",
    ),
    "steering_asymmetry": EffectText(
        "a steering that turns farther to one side",
        "the wheels turn {gain:size percent} farther to the {gain:left|right} than commanded, and as much less to the "
        "other side",
        "left and right circles at the same command have the same radius",
    ),
    "steering_nonlinearity": EffectText(
        "a steering that yields less towards full lock",
        "the wheel angle grows ever less than its command and would never exceed {saturation}",
        "a slow circle at full lock, where tyres do not slip, is as tight as the linear steering says",
    ),
    "throttle_deadband": EffectText(
        "a dead band of the throttle",
        "the motor does not answer to throttle commands smaller than {width:percent} of full",
        "the car slows down just as strongly when it rolls with no throttle at all (a resistance)",
    ),
    "throttle_nonlinearity": EffectText(
        "a curved throttle response",
        "the motor's force grows as the throttle to the power of {exponent}, not in proportion to it",
        "the curve has a sharp corner (a dead band or a limit) rather than a bend over the whole range",
    ),
    "motor_lag": EffectText(
        "a lag of the motor",
        "the motor's force lags behind the throttle by {time_constant}",
        "after a step of throttle nothing happens for a while and then everything at once (a delay)",
    ),
    "motor_saturation": EffectText(
        "a limit of the motor's force",
        "the motor gives no more than {force} of drive force, whatever the throttle",
        "the limit moves with the grip of the floor, or with the load on the wheels",
    ),
    "traction_limit": EffectText(
        "a limit of traction",
        "the driven wheels ({axle:choice rear|all}) pass on no more than {share} times the force of full grip",
        "the same limit is reached on a floor with more grip (then it is the motor's)",
    ),
    "brake_asymmetry": EffectText(
        "a brake that is not the drive reversed",
        "the motor brakes with {gain_ratio} times the force with which it drives at the same throttle",
        "braking from several speeds needs several such ratios",
    ),
    "battery_sag": EffectText(
        "a drive that changes as the battery runs down",
        "the drive {rate:weakens|strengthens} by {rate:size each minute}",
        "cornering changes along with it (then it is grip), or the drive stays weak after the battery is charged",
    ),
    "rolling_resistance": EffectText(
        "rolling resistance",
        "a rolling resistance of {force} holds the car back at any speed",
        "rolling out with no throttle, the car loses less speed each second the slower it gets",
    ),
    "aerodynamic_drag": EffectText(
        "a drag that grows with the square of speed",
        "a drag of {coefficient} times speed squared holds the car back",
        "rolling out from high speed with no throttle shows no such drag (then the motor is at its limit)",
    ),
    "cornering_drag": EffectText(
        "a drag of the steered wheels",
        "steered wheels hold the car back by {coefficient} of wheel angle",
        "the loss of speed in corners depends on how fast they are driven rather than on the wheel angle",
    ),
    "tyre_saturation": EffectText(
        "the limit of tyre grip",
        "the side force of the tyres saturates, at a friction of {mu_front} in front and {mu_rear} at the rear",
        "turns tighten less than linearly even at walking pace (then it is the steering)",
    ),
    "friction_ellipse": EffectText(
        "grip shared between driving and cornering",
        "driving and braking take side force from rear tyres, as a friction circle at {scale} times the drive force",
        "driving and braking shift the balance in opposite directions (then load moves between the axles)",
    ),
    "longitudinal_slip": EffectText(
        "slipping driven wheels",
        "the driven wheels slip: their inertia is {inertia}, the tyres' stiffness along {stiffness}",
        "the push of the motor is late by the same time at low and at high throttle (then the motor lags)",
    ),
    "tyre_relaxation": EffectText(
        "the rolling distance in which side force builds up",
        "the tyres roll {length} before their side force has built up",
        "the side force is late by the same time, rather than by the same distance, at two speeds",
    ),
    "load_transfer": EffectText(
        "load that moves between the axles",
        "speeding up and braking move load between the axles, as of a centre of mass {height} above the floor",
        "braking and speeding up change the balance in the same direction (then they share the tyres' grip)",
    ),
    "roll_dynamics": EffectText(
        "a body that rolls",
        "the body rolls at {frequency} with a damping ratio of {damping}, and load that changes sides costs grip, "
        "with a sensitivity of {sensitivity}",
        "fast weaving shows no resonance near that frequency",
    ),
    "friction_drift": EffectText(
        "a grip that changes with time",
        "grip {rate:grows|falls} by {rate:size each minute}",
        "only the drive changes with time and cornering does not (then it is the battery)",
    ),
    "low_friction_patch": EffectText(
        "a slippery place",
        "grip falls by {loss:percent} within {radius} of the place x = {x}, y = {y}",
        "the car slides alike elsewhere at the same speed and turn, or does not slide there on another lap",
    ),
    "aerodynamic_downforce": EffectText(
        "downforce",
        "the tyres carry {coefficient} times speed squared more than the car's weight",
        "the fastest corner of a given radius is no faster than grip without downforce allows",
    ),
    "yaw_damping": EffectText(
        "a moment against turning",
        "a moment of {coefficient} of yaw rate holds the car from turning, as a locked axle does",
        "tight circles at walking pace are as tight as the steering says",
    ),
    "torque_steer": EffectText(
        "a throttle that turns the car",
        "full throttle turns the car to the {coefficient:left|right} with a moment of {coefficient:size}",
        "the car pulls to that side when it rolls with no throttle, too",
    ),
    "lateral_bias": EffectText(
        "a side force",
        "a constant force of {force:size} pushes the car to the {force:left|right}",
        "the path's curvature from it does not fade as speed grows (then the steering is off centre), or it turns with "
        "the heading (then the floor slopes)",
    ),
    "road_slope": EffectText(
        "a floor that slopes",
        "the floor slopes by {angle}; straight up is where a heading of {direction} points",
        "the pull does not change sign when the car drives the other way",
    ),
    "mocap_latency": EffectText(
        "a motion-capture latency that is not the car file's",
        "all that motion capture measures is {latency} old",
        "a latency measured against a known event, such as a tap on the car, equals the car file's",
    ),
    "marker_offset": EffectText(
        "a tracked point beside the centre of mass",
        "motion capture tracks a point {ahead:size} {ahead:ahead of|behind} and {left:size} to the {left:left|right} "
        "of the centre of mass",
        "on a slow circle the tracked point shows the side velocity of the centre of mass",
    ),
    "mocap_yaw_misalignment": EffectText(
        "a heading that motion capture measures askew",
        "motion capture sees the car turned {angle:size} to the {angle:left|right} of where it points",
        "driving straight with the steering centred, the measured side velocity does not grow with speed",
    ),
    "velocity_filter_lag": EffectText(
        "a filter in the recorded velocities",
        "the recorded velocities went through a filter that lags by {time_constant}",
        "the poses are as late as the velocities (then the car, or the commands, are late)",
    ),
}

SEPARATING: dict[frozenset[str], tuple[str, str]] = {
    frozenset(pair): (drive, why)
    for pair, drive, why in (
        (
            ("steering_delay", "steering_lag"),
            "steering_steps",
            "a delay shifts every step by the same pause; a lag starts at once and rounds it off",
        ),
        (
            ("steering_lag", "steering_rate_limit"),
            "steering_steps",
            "a lag takes as long for a small as for a large step; a limited rate takes longer for the large one",
        ),
        (
            ("steering_lag", "tyre_relaxation"),
            "steering_steps",
            "a lag lasts as long at any speed; building up side force takes a distance, so drive it twice, the second "
            "time with --max-throttle 0.15",
        ),
        (
            ("steering_deadband", "steering_backlash"),
            "steering_chirp",
            "play opens at each turn back, a dead band only around straight ahead",
        ),
        (
            ("steering_offset", "lateral_bias"),
            "throttle_ramp",
            "the curvature from wheels off centre stays as speed grows; that from a side force fades",
        ),
        (
            ("steering_offset", "mocap_yaw_misalignment"),
            "throttle_ramp",
            "wheels off centre curve the path; a heading measured askew only shows as side velocity growing with speed",
        ),
        (
            ("steering_offset", "steering_asymmetry"),
            "figure_eight",
            "an offset tightens one circle and widens the other alike at any command; an asymmetry grows with it",
        ),
        (
            ("steering_nonlinearity", "tyre_saturation"),
            "slow_circle",
            "at walking pace tyres do not slip, so a wide circle at full lock is the steering's",
        ),
        (
            ("throttle_deadband", "rolling_resistance"),
            "coast_down",
            "with no throttle a dead band has no say, a resistance still slows the car",
        ),
        (
            ("throttle_nonlinearity", "motor_saturation"),
            "throttle_ramp",
            "a limit shows as a corner in the force over the throttle, a curve bends all the way",
        ),
        (
            ("throttle_nonlinearity", "throttle_deadband"),
            "throttle_ramp",
            "a dead band shows as a corner at small throttle, a curve bends all the way",
        ),
        (
            ("throttle_delay", "motor_lag"),
            "throttle_steps",
            "a delay shifts every step by the same pause; a lag starts at once and rounds it off",
        ),
        (
            ("motor_saturation", "traction_limit"),
            "throttle_ramp",
            "the limit of traction sinks as the turn takes grip, the motor's stays",
        ),
        (
            ("motor_saturation", "aerodynamic_drag"),
            "coast_down",
            "with no throttle the motor's limit has no say, drag still slows the car",
        ),
        (
            ("traction_limit", "friction_ellipse"),
            "throttle_ramp",
            "a limit caps the drive force; shared grip takes side force long before the cap",
        ),
        (
            ("battery_sag", "friction_drift"),
            "figure_eight",
            "driven over and over for some minutes: a weak battery slows the car, lost grip widens its turns",
        ),
        (
            ("friction_ellipse", "load_transfer"),
            "throttle_steps",
            "shared grip is lost both in driving and in braking; moved load helps the rear in one and hurts in the "
            "other",
        ),
        (
            ("longitudinal_slip", "motor_lag"),
            "throttle_steps",
            "a lag lasts as long for a small as for a large step; spinning wheels come with the large one",
        ),
        (
            ("longitudinal_slip", "traction_limit"),
            "throttle_steps",
            "wheels that spin need time to spin up and to catch again; a plain limit acts at once",
        ),
        (
            ("load_transfer", "roll_dynamics"),
            "steering_chirp",
            "a rolling body answers late and most near its own frequency; load moves at once",
        ),
        (
            ("lateral_bias", "road_slope"),
            "figure_eight",
            "a slope pulls the other way when the heading turns round, a side force of the car turns with it",
        ),
        (
            ("velocity_filter_lag", "motor_lag"),
            "throttle_steps",
            "compare velocity with the slope of the position: a filter delays the first against the second",
        ),
        (
            ("velocity_filter_lag", "steering_lag"),
            "steering_steps",
            "compare yaw rate with the slope of the yaw: a filter delays the first against the second",
        ),
    )
}
"""Manoeuvre that tells two look-alikes apart, and why. Commands that act late and pictures that come late look the
same from outside in every drive, so that pair has none."""
