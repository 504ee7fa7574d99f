//! Units in which settings are written as whole numbers: MiB, seconds, days.

use std::borrow::Cow;
use std::time::Duration;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

pub const SECOND: u64 = 1;
/// Seconds of a day.
pub const DAY: u64 = 86_400;
pub const MEGA: u64 = 1_000_000;
/// Bytes of a MiB.
pub const MIB: u64 = 1 << 20;

/// Writes a quantity in units of `UNIT`, for `#[serde(with)]`; fractions are cut off.
pub struct In<const UNIT: u64>;

/// A quantity with a unit.
pub trait Quantity: Copy {
    /// In bytes, seconds or pixels.
    fn amount(self) -> u64;
    /// From bytes, seconds or pixels.
    fn of(amount: u64) -> Self;
}

impl Quantity for u64 {
    fn amount(self) -> u64 {
        self
    }

    fn of(amount: u64) -> Self {
        amount
    }
}

impl Quantity for usize {
    fn amount(self) -> u64 {
        self as u64
    }

    fn of(amount: u64) -> Self {
        Self::try_from(amount).unwrap_or(Self::MAX)
    }
}

impl Quantity for Duration {
    fn amount(self) -> u64 {
        self.as_secs()
    }

    fn of(amount: u64) -> Self {
        Self::from_secs(amount)
    }
}

impl<const UNIT: u64> In<UNIT> {
    const NAME: &'static str = match UNIT {
        SECOND => "seconds",
        DAY => "days",
        MEGA => "megapixels",
        _ => "MiB",
    };

    pub fn serialize<T: Quantity, S: Serializer>(quantity: &T, to: S) -> Result<S::Ok, S::Error> {
        (quantity.amount() / UNIT).serialize(to)
    }

    pub fn deserialize<'de, T: Quantity, D: Deserializer<'de>>(from: D) -> Result<T, D::Error> {
        Ok(T::of(u64::deserialize(from)?.saturating_mul(UNIT)))
    }
}

impl<const UNIT: u64> JsonSchema for In<UNIT> {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        Self::NAME.into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "integer", "minimum": 0, "format": Self::NAME })
    }
}
