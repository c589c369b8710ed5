//! Car following: the Intelligent Driver Model (Treiber et al. 2000) with an emergency brake.

/// Greatest braking that the model itself asks for.
const COMFORT_BRAKE_M_S2: f64 = 5.0;
/// What the tyres can do.
const EMERGENCY_BRAKE_M_S2: f64 = 9.0;
/// Braking beyond which a driver no longer cares about comfort.
const EMERGENCY_FROM_M_S2: f64 = 4.0;
/// A gap that is always an emergency.
const TOUCHING_M: f64 = 1.0;

/// How one driver follows others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Temper {
    /// Speed on an empty road.
    pub(crate) desired_m_s: f64,
    /// Gap kept at standstill.
    pub(crate) gap_m: f64,
    /// Time gap kept while driving.
    pub(crate) headway_s: f64,
    pub(crate) accelerate_m_s2: f64,
    pub(crate) brake_m_s2: f64,
}

/// What a driver follows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Leader {
    /// Bumper to bumper.
    pub(crate) gap_m: f64,
    pub(crate) speed_m_s: f64,
}

/// The acceleration that `temper` asks for at `speed` behind `leader`.
pub(crate) fn acceleration(temper: &Temper, speed: f64, leader: Option<Leader>) -> f64 {
    let free = 1.0 - (speed / temper.desired_m_s).powi(4);
    let Some(leader) = leader else {
        return (temper.accelerate_m_s2 * free).max(-COMFORT_BRAKE_M_S2);
    };
    let closing = speed - leader.speed_m_s;
    let gap = leader.gap_m.max(0.1);
    let needed = closing.max(0.0).powi(2) / (2.0 * (gap - TOUCHING_M).max(0.1));
    if leader.gap_m < TOUCHING_M && speed > 0.1 || needed > EMERGENCY_FROM_M_S2 {
        return -EMERGENCY_BRAKE_M_S2;
    }
    let dynamic = speed * temper.headway_s
        + speed * closing / (2.0 * (temper.accelerate_m_s2 * temper.brake_m_s2).sqrt());
    let wanted = temper.gap_m + dynamic.max(0.0);
    let interaction = (wanted / gap).powi(2);
    (temper.accelerate_m_s2 * (free - interaction)).max(-COMFORT_BRAKE_M_S2)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEMPER: Temper = Temper {
        desired_m_s: 12.0,
        gap_m: 2.0,
        headway_s: 1.0,
        accelerate_m_s2: 2.0,
        brake_m_s2: 3.0,
    };

    #[test]
    fn matches_the_model_by_hand() {
        // Free road at half the desired speed: 2 (1 - 1/16).
        assert!((acceleration(&TEMPER, 6.0, None) - 1.875).abs() < 1e-12);
        // Equal speeds: s* = 2 + 6, so 2 (1 - 1/16 - (8/16)^2).
        let leader = Leader {
            gap_m: 16.0,
            speed_m_s: 6.0,
        };
        assert!((acceleration(&TEMPER, 6.0, Some(leader)) - 1.375).abs() < 1e-12);
    }

    #[test]
    fn brakes_hard_only_in_an_emergency() {
        let wall = |gap_m| {
            Some(Leader {
                gap_m,
                speed_m_s: 0.0,
            })
        };
        assert_eq!(
            acceleration(&TEMPER, 12.0, wall(8.0)),
            -EMERGENCY_BRAKE_M_S2
        );
        assert!(acceleration(&TEMPER, 12.0, wall(40.0)) > -COMFORT_BRAKE_M_S2);
    }

    #[test]
    fn stands_still_at_its_gap() {
        let leader = Leader {
            gap_m: TEMPER.gap_m,
            speed_m_s: 0.0,
        };
        assert!(acceleration(&TEMPER, 0.0, Some(leader)).abs() < 1e-12);
    }
}
