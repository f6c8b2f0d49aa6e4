"""Equations of all dynamics effects, written independently of the simulator, and their integration by scipy."""

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import brentq

G, RADIUS = 9.81, 0.033
DRIVE = [(0.3, 0.5), (-0.6, 0.4), (0.1, -0.6), (0.8, 0.5), (-0.2, 0.0)]
"""Steering and throttle, each for ``HOLD_S`` [s]."""
HOLD_S = 0.2
START = (0.2, -0.1, 0.7, 1.8, 0.1, -0.4)

THROTTLES = (-1, -0.6, -0.35, -0.2, -0.1, -0.04, 0, 0.04, 0.1, 0.2, 0.35, 0.6, 1)
SPEEDS = (-4.5, -3, -2, -1, -0.5, 0, 0.5, 1, 2, 3, 4.5)
FORCE_SPEEDS = (-3, -1.5, -0.5, 0, 0.5, 1, 1.5, 2, 2.5, 3, 4)
FORCE_SLIPS = (-0.5, -0.3, -0.18, -0.1, -0.04, 0, 0.04, 0.1, 0.18, 0.3, 0.5)
SLIPS = (0, 0.04, 0.1, 0.2, 0.4, 0.8)
ACCELERATIONS = {"front_tyre_map": (-6, -3, 0, 3, 6), "rear_tyre_map": (-8, -5, -2.5, 0, 2.5, 5, 8)}


def smaller_root(shape: float, force: float, limit: float) -> float:
    """The smaller root of ``shape m^2 - (force + limit) m + force limit = 0``."""
    return float(np.roots([shape, -(force + limit), force * limit]).real.min())


def drive_map_at(e, throttle, speed):
    """The drive map by scipy's interpolation on a regular grid."""
    grid = np.array(list(e["drive_map"].values())).reshape(len(THROTTLES), len(SPEEDS))
    within = [np.clip(throttle, -1, 1), np.clip(speed, SPEEDS[0], SPEEDS[-1])]
    return float(RegularGridInterpolator((THROTTLES, SPEEDS), grid)(within)[0])


def tyre_map_at(e, name, acceleration, slip):
    """A tyre map by scipy's interpolation on a regular grid; its deviation is 0 at the slip 0."""
    knots = ACCELERATIONS[name]
    grid = np.array(list(e[name].values())).reshape(len(knots), len(SLIPS) - 1)
    grid = np.hstack([np.zeros((len(knots), 1)), grid])
    within = [np.clip(acceleration, knots[0], knots[-1]), np.clip(slip, 0, SLIPS[-1])]
    return float(RegularGridInterpolator((knots, SLIPS), grid)(within)[0])


def over_speed(e, name, speed):
    """A curve over the speed by numpy's interpolation; its deviation is 0 at rest."""
    values = list(e[name].values())
    return float(np.interp(speed, FORCE_SPEEDS, [*values[:3], 0.0, *values[3:]]))


def over_slip(e, name, slip, vx):
    """A curve over the slip angle by numpy's interpolation, which fades at rest."""
    return float(np.interp(slip, FORCE_SLIPS, list(e[name].values()))) * math.tanh(abs(vx) / 0.2)


def spinning_rims(e, p, vx, vy, r, demand, grip):
    """Force along the car [N] and share of the side force, of rims that balance motor and tyres."""
    speed, slope = max(abs(vx), 0.3), p.rear_b * p.rear_c
    across = slope * (vy - p.rear_axle_m * r) / speed
    peak = e["combined_slip"]["grip_ratio"] * grip

    def force(rims):
        along = slope * rims / speed
        return peak * along / math.hypot(1.0, across, along)

    rims = brentq(lambda w: force(w) + p.damping_nspm * w - demand, 0.0, 100.0, xtol=1e-14)
    return force(rims), math.hypot(1.0, across) / math.hypot(1.0, across, slope * rims / speed)


def reference_rates(t, s, d, u, p, e):
    """[x, y, yaw, vx, vy, r, F_front, F_rear, rim speed, roll, roll rate] by the catalogue's equations."""
    x, y, yaw, vx, vy, r, lag_front, lag_rear, rim, roll, roll_rate = s
    m, a, b = p.mass_kg, p.front_axle_m, p.rear_axle_m
    has = e.__contains__
    if has("wheelbase"):
        a, b = (1 + e["wheelbase"]["change"]) * a, (1 + e["wheelbase"]["change"]) * b
    if has("centre_of_mass"):
        a, b = a - e["centre_of_mass"]["ahead"], b + e["centre_of_mass"]["ahead"]
    z_front, z_rear = m * G * b / (a + b), m * G * a / (a + b)
    if has("aerodynamic_downforce"):
        extra = e["aerodynamic_downforce"]["coefficient"] * vx**2
        z_front, z_rear = z_front + extra * b / (a + b), z_rear + extra * a / (a + b)
    mu_front, mu_rear = p.front_mu, p.rear_mu
    if has("friction_drift"):
        mu_front, mu_rear = (mu * (1 + e["friction_drift"]["rate"] * t) for mu in (mu_front, mu_rear))
    if has("low_friction_patch"):
        q = e["low_friction_patch"]
        depth = (q["radius"] - math.dist((x, y), (q["x"], q["y"]))) / 0.05
        share = 1 - q["loss"] * min(max(depth + 0.5, 0.0), 1.0)
        mu_front, mu_rear = mu_front * share, mu_rear * share
    drive = p.drive_gain_n * u
    if has("battery_sag"):
        drive *= 1 - e["battery_sag"]["rate"] * t
    if has("brake_asymmetry") and drive * vx < 0:
        drive *= e["brake_asymmetry"]["gain_ratio"]
    if has("drive_map"):
        drive += m * drive_map_at(e, u, vx)
    if has("drag_brake"):
        drive -= e["drag_brake"]["force"] * max(1 - abs(u) / 0.05, 0) * math.tanh(vx / 0.05)
    if has("motor_saturation"):
        limit, shape = e["motor_saturation"]["force"], 1 - e["motor_saturation"].get("roundness", 0)
        drive = math.copysign(smaller_root(shape, abs(drive), limit), drive)
    if has("drive_change"):
        drive *= 1 + e["drive_change"]["share"]
    demand = drive - p.damping_nspm * vx

    def controlled(force):
        if not has("speed_controller"):
            return force
        q = e["speed_controller"]
        limit, shape = q["forward_force" if force > 0 else "backward_force"], 1 - q.get("roundness", 0)
        return math.copysign(smaller_root(shape, abs(force), limit), force)

    body_x = body_y = moment = 0.0
    if has("rolling_resistance"):
        body_x -= e["rolling_resistance"]["force"] * math.tanh(vx / 0.05)
    if has("aerodynamic_drag"):
        body_x -= e["aerodynamic_drag"]["coefficient"] * vx * abs(vx)
    if has("cornering_drag"):
        body_x -= e["cornering_drag"]["coefficient"] * abs(d) * math.tanh(vx / 0.05)
    if has("road_slope"):
        down = -m * G * math.sin(e["road_slope"]["angle"])
        east, north = (down * f(e["road_slope"]["direction"]) for f in (math.cos, math.sin))
        body_x += east * math.cos(yaw) + north * math.sin(yaw)
        body_y += -east * math.sin(yaw) + north * math.cos(yaw)
    if has("lateral_bias"):
        body_y += e["lateral_bias"]["force"]
    if has("yaw_damping"):
        moment -= e["yaw_damping"]["coefficient"] * r

    if has("wind"):
        q = e["wind"]
        ahead = q["direction"] - yaw
        air = np.array([vx, vy]) - q["speed"] * np.array([math.cos(ahead), math.sin(ahead)])
        push = q["coefficient"] * (math.hypot(vx, vy) * np.array([vx, vy]) - np.linalg.norm(air) * air)
        body_x, body_y = body_x + push[0], body_y + push[1]
    if has("locked_axle"):
        moment -= e["locked_axle"]["moment"] * math.tanh(r / max(abs(vx), 0.3))
    if has("braking_pull") and u < 0:
        moment -= e["braking_pull"]["coefficient"] * u
    if has("body_force"):
        q = e["body_force"]
        body_x, body_y, moment = body_x + q["forward"], body_y + q["left"], moment + q["moment"]
    if has("side_force_over_speed"):
        body_y += m * over_speed(e, "side_force_over_speed", vx)
    if has("yaw_moment_over_speed"):
        moment += m * over_speed(e, "yaw_moment_over_speed", vx)
    if has("coast_brake"):
        body_x -= e["coast_brake"]["coefficient"] * vx * math.exp(-((u / 0.05) ** 2))

    side = vy + a * r
    slip_front = math.atan2(side * math.cos(d) - vx * math.sin(d), max(abs(vx * math.cos(d) + side * math.sin(d)), 0.3))
    if has("side_force_over_slip"):
        body_y += m * over_slip(e, "side_force_over_slip", slip_front, vx)
    if has("yaw_moment_over_slip"):
        moment += m * over_slip(e, "yaw_moment_over_slip", slip_front, vx)
    if has("front_wheel_play"):
        slip_front -= np.clip(slip_front, -e["front_wheel_play"]["angle"], e["front_wheel_play"]["angle"])
    slip_rear = math.atan2(vy - b * r, max(abs(vx), 0.3))
    front_each = -mu_front * math.sin(p.front_c * math.atan(p.front_b * slip_front))
    rear_each = -mu_rear * math.sin(p.rear_c * math.atan(p.rear_b * slip_rear))
    height = e["load_transfer"]["height"] if has("load_transfer") else 0.0
    transferred_load, force = 0.0, demand
    for _ in range(60):  # fixed-point iteration of load transfer and traction limit
        force = demand
        if has("combined_slip"):
            transmitted, _ = spinning_rims(e, p, vx, vy, r, abs(demand), mu_rear * (z_rear + transferred_load))
            force = math.copysign(transmitted, demand)
        force = controlled(force)
        if has("traction_limit"):
            q = e["traction_limit"]
            grip = mu_rear * (z_rear + transferred_load) + (
                mu_front * (z_front - transferred_load) if q.get("axle") == "all" else 0.0
            )
            limit, shape = q["share"] * grip, 1.0 - q.get("roundness", 0.0)
            force = math.copysign(smaller_root(shape, abs(force), limit), force)
        at_front = e["all_wheel_drive"]["share"] * force * (math.cos(d) - 1) if has("all_wheel_drive") else 0.0
        m_ax = force + at_front + body_x - front_each * (z_front - transferred_load) * math.sin(d)
        before, transferred_load = transferred_load, m_ax * height / (a + b)
        if math.isclose(before, transferred_load, rel_tol=1e-13):
            break
    z_front, z_rear = z_front - transferred_load, z_rear + transferred_load
    f_front, f_rear = front_each * z_front, rear_each * z_rear
    if has("front_tyre_map"):
        front_map = tyre_map_at(e, "front_tyre_map", force / m, abs(slip_front))
        f_front -= z_front * front_map * math.copysign(1.0, slip_front)
    if has("rear_tyre_map"):
        f_rear -= z_rear * tyre_map_at(e, "rear_tyre_map", force / m, abs(slip_rear)) * math.copysign(1.0, slip_rear)
    if has("grip_change"):
        f_front, f_rear = ((1 + e["grip_change"]["share"]) * f for f in (f_front, f_rear))
    rim_rate = 0.0
    if has("longitudinal_slip"):
        q = e["longitudinal_slip"]
        limit = mu_rear * z_rear
        at_wheels, force = force, limit * math.tanh(q["stiffness"] * (rim - vx) / max(abs(vx), 0.3) / limit)
        rim_rate = RADIUS**2 / q["inertia"] * (at_wheels - force)
    if has("combined_slip"):
        transmitted, side_share = spinning_rims(e, p, vx, vy, r, abs(demand), mu_rear * z_rear)
        if abs(force) < 0.9999 * transmitted:  # the motor's limit, not the tyres'
            side_share = math.cos(math.asin(force / (e["combined_slip"]["grip_ratio"] * mu_rear * z_rear)))
        f_rear *= side_share
    front_share = e["all_wheel_drive"]["share"] if has("all_wheel_drive") else 0.0
    if has("friction_ellipse"):
        q = e["friction_ellipse"]

        def beside(side, force_x, peak):
            side_share = math.cos(math.asin(min(max(q["scale"] * force_x / peak, -0.98), 0.98)))
            limited = math.copysign(min(abs(side), side_share * peak), side)
            return limited if q.get("action") == "limits" else side_share * side

        f_rear = beside(f_rear, (1 - front_share) * force, mu_rear * z_rear)
        f_front = beside(f_front, front_share * force, mu_front * z_front) if front_share else f_front
    if has("torque_steer"):
        q = e["torque_steer"]
        moment += q["coefficient"] * (force / p.drive_gain_n if q.get("source") == "force" else u)
    roll_acc = 0.0
    if has("roll_dynamics"):
        q = e["roll_dynamics"]
        f_front, f_rear = (f * (1 - q.get("sensitivity", 0.3) * roll**2) for f in (f_front, f_rear))
        used = (f_front * math.cos(d) + f_rear) / (mu_front * z_front + mu_rear * z_rear)
        w = 2 * math.pi * q["frequency"]
        roll_acc = w**2 * (used - roll) - 2 * q["damping"] * w * roll_rate
    if has("front_side_force"):
        f_front += e["front_side_force"]["force"] * math.tanh(abs(vx) / 0.2)
    if has("rear_side_force"):
        f_rear += e["rear_side_force"]["force"] * math.tanh(abs(vx) / 0.2)
    lag_rates = (0.0, 0.0)
    if has("tyre_relaxation"):
        per_s = max(abs(vx), 0.3) / e["tyre_relaxation"]["length"]
        lag_rates = ((f_front - lag_front) * per_s, (f_rear - lag_rear) * per_s)
        f_front, f_rear = lag_front, lag_rear
    wheel = np.array([[math.cos(d), -math.sin(d)], [math.sin(d), math.cos(d)]])  # axes of the front wheels, in the body
    front_along, front_across = wheel @ [front_share * force, f_front]
    return [
        vx * math.cos(yaw) - vy * math.sin(yaw),
        vx * math.sin(yaw) + vy * math.cos(yaw),
        r,
        ((1 - front_share) * force + front_along + body_x) / m + vy * r,
        (f_rear + front_across + body_y) / m - vx * r,
        (a * front_across - b * f_rear + moment) / p.yaw_inertia_kgm2,
        *lag_rates,
        rim_rate,
        roll_rate,
        roll_acc,
    ]


def by_scipy(p, effects, start=START, drive=DRIVE):
    hidden = [0.0, 0.0, start[3], 0.0, 0.0]

    # Hidden states start in steady state: integrate them with a fixed body state.
    def held(t, s):
        return [0.0] * 6 + reference_rates(0.0, [*start, *s[6:]], 0.0, 0.0, p, effects)[6:]

    state = np.array([*start, *hidden])
    if set(effects) & {"tyre_relaxation", "roll_dynamics"}:
        state[6:] = solve_ivp(held, (0, 30), state, rtol=1e-9, atol=1e-11, method="LSODA").y[6:, -1]
        state[8] = start[3]
    if "longitudinal_slip" in effects:  # wheels and car accelerate equally
        q, demand = effects["longitudinal_slip"], -p.damping_nspm * start[3]
        limit = p.rear_mu * p.mass_kg * G * p.front_axle_m / (p.front_axle_m + p.rear_axle_m)
        share = demand / (1 + q["inertia"] / RADIUS**2 / p.mass_kg) / limit
        state[8] = start[3] + math.atanh(share) * limit * max(abs(start[3]), 0.3) / q["stiffness"]
    for k, (steering, throttle) in enumerate(drive):
        d = p.max_angle_rad * steering
        state = solve_ivp(
            lambda t, s, d=d, u=throttle: reference_rates(t, s, d, u, p, effects),
            (k * HOLD_S, (k + 1) * HOLD_S),
            state,
            rtol=1e-8,
            atol=1e-10,
            method="LSODA" if "longitudinal_slip" in effects else "DOP853",
            max_step=0.05,
        ).y[:, -1]
    return state
